"""Parameters out of measurements: one file for each procedure, and a vehicle file as the result."""
