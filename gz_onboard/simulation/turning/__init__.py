"""Chassis models that turn: straight (for comparison), planar bicycle, leaning bicycle, and a study of the three.

Signs, everywhere in this package: x forward, y to the left, z up (ISO 8855). Steer, yaw rate, lateral speed, side
force, slip angle and camber are positive to the left, as the IMU's yaw rate is; lean is positive to the right, as
everywhere in the project. A steady left turn thus has positive yaw rate and side force, and negative lean.
"""
