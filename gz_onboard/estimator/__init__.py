"""State of charge, road state, slow learners and the range forecast. No I/O, no clock."""
