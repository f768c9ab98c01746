"""The command `export`: logs in other formats of frames, and their contents as tables."""
