"""What the simulation gets wrong: shown, named, mended, and the gain measured."""
