"""The range for the rider: in a terminal and on a web page."""
