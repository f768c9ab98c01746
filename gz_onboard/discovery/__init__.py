"""Differences between rides and the vehicle's model, and their causes.

- `grid`: a ride on an even time grid; `residuals` and `channels`: measurement minus model, one channel each
- `parameters`: priors, scatter between rides, candidate causes; `mixed_model`: the linear model of all channels
- `curves`: smooth curves over quantities; `search`: the causes, tested on rides held out
- `judgement`: verdict, certainty, detection limits and the report; `baseline`: knowledge from healthy rides
- `extend`: the vehicle file with the causes; `report`: terminal and HTML; `run` and `command`: a discovery
"""
