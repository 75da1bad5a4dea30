"""What networks trained on other pictures know about these."""
