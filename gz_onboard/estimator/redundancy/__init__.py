"""Sensors checked against each other: which of them contradicts the others is found, named and left out.

Nothing here is learned from a single sensor. Each quantity has witnesses that do not depend on each other: the
speeds of motor, wheels and GPS. The majority is believed at once; a sensor that contradicts it for `FAULTY_AFTER`
seconds is faulty, and is left out until it has agreed for `RECOVERED_AFTER` seconds in which there was something to
agree about. Where nothing decides, all sensors concerned are left out: the quantity is then reported as not known.

All of it runs once for each step of the estimator, on the means of that step. To be left out is to be missing
(`Signal.trusted`): what then stands in, and how much less certain the estimate becomes, is the same as if the
sensor were silent.

A new check of single sensors is a class with `counters` and ``step`` (`SensorCheck`) in a module of its own, and an
entry in `Redundancy`.
"""
