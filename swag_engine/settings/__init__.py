"""What a user chooses."""
