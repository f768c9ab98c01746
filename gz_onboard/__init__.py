"""Real-time remaining range, with its uncertainty, on an electric scooter's CAN bus."""

__version__ = "0.1.0"
