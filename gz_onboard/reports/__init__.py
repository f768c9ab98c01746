"""Reports of all commands: how pictures and pages look, one JSON writer, the charts of a ride."""
