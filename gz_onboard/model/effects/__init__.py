"""One file for each physical effect; see `gz_onboard.model.effect` for what such a file holds."""
