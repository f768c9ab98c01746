"""Input and output: CAN channels, the codec between frames and events, logs. Knows no physics."""
