"""The operations of the engine in plain torch: they define what the native backends compute."""
