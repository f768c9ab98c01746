"""What rides show that the model of the vehicle does not: shown, named, mended, and the gain measured.

A pipeline, each stage with one thing in and one out. A module imports from the stages before its own only.

    read          samples -> `Ride`: a ride on one grid of time                          grid
    residuals     `Ride` -> each channel, measured less model                            system, residuals, channels,
                                                                                         blocks
    linear model  `Ride` -> `LinearRide` about a `MixedModel`                            prior, candidates, linear,
                  of what is known of the vehicle: from its file alone, or a baseline    mixed_model, uncalibrated,
                                                                                         baseline_file
    search        `SearchProblem` -> `Selection`: the causes that explain the rides      search, curve_forms, curves,
                                                                                         baseline, selection
    judgement     `SearchProblem` -> `Discovery`: those that are accepted, each ride's   constancy, cross_validation,
                  own wind, what has no name; how sure, and what could stand in          acceptance, winds, energy,
                                                                                         unexplained, verdict
    report        `Discovery` -> `Report` (plain data), text, HTML page, vehicle file    gain, detectability, discovery,
                                                                                         breakdown, summary, plots,
                                                                                         page, extension
    command       the command line

The types of the report are in `result`, below all stages.
"""
