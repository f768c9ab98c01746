"""Checks sensors against each other: finds the one that contradicts the others, names it and leaves it out.

Each group (speeds; currents and voltages; accelerometer and altitude; slow signals and axes) predicts a member from the
others, from a model or from the member's own past. The normalised residual goes into a fault counter per sensor. A
sensor that explains the contradiction is left out at once, and is faulty after `faulty_after_s` until it has agreed for
`recovered_after_s`. Two members that contradict each other with nothing to decide are disputed: neither is
believed alone, and the uncertainty grows.

A sensor that is left out counts as silent (`Signal.trusted`). Import from the modules of this package.
"""
