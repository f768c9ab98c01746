"""Whether a log fits a vehicle file."""
