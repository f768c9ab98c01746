"""Physical effects and the battery, each written once, for simulation, on board and discovery alike."""
