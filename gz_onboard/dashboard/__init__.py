"""What the rider sees."""
