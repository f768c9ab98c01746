"""The road as a file has it: what is known of a route, and the speed that it allows."""
