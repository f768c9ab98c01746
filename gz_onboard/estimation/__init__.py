"""The command `estimate`: recorded rides through the pipeline of the daemon."""
