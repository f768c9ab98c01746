"""Bridges from the range frames to an MQTT broker and to Foxglove."""
