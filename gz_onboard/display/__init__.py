"""The rider's display: a terminal or a page, from the range frames on the bus."""
