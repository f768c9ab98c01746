"""Constants of nature, of units and of the normal distribution, and the usual temperature."""

GRAVITY = 9.80665  # m/s², standard acceleration of free fall (CGPM 1901)
KELVIN = 273.15  # K: 0 degC
MINUTE, HOUR = 60.0, 3600.0  # s
THERMAL_VOLTAGE = 8.617333e-5  # V/K: gas constant over Faraday's
WH = HOUR  # J
WH_PER_KM = 3.6  # J/m

EARTH_RADIUS = 6_371_000.0  # m, mean
METRES_PER_DEGREE = 111_200.0  # of latitude; 0.3 % off at most
BENCH_TEMPERATURE = 25.0  # degC, at which capacities are given
MILD = 20.0  # degC: of a vehicle and of the air where nothing else is known
DECILE = 1.2815515655446004  # sd of a normal distribution: 10 % are beyond
