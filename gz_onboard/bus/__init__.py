"""The way in and out: CAN channels, the codec between frames and events, logs. Knows no physics."""
