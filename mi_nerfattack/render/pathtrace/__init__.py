"""Pictures of Mitsuba scenes: loading, daylight, views, frames, sequences."""
