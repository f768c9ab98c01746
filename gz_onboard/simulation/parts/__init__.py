"""The parts of the scooter, one file each: state and equations of one component, none knows another.

`gz_onboard.simulation.scooter` wires them. A part is replaced by an object with the same methods.
"""
