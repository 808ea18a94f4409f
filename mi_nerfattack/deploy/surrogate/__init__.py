"""The surrogate: scenes of fields as sensors, and one vehicle in them."""
