"""What the range frames say, to who is not on the bus: an MQTT broker, Foxglove."""
