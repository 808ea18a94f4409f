"""A made phone video of the bundled room, through the whole chain."""
