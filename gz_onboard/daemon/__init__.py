"""The daemon: what systemd runs on board."""
