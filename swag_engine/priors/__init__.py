"""Networks that predict depth and frames."""
