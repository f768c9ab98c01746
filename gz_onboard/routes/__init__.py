"""Routes: how they are read from files, and the speed that they allow."""
