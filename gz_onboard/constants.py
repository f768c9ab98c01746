"""Constants of nature."""

GRAVITY = 9.80665  # m/s², standard acceleration of free fall (CGPM 1901)
