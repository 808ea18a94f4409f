"""Performance figures, measured side by side with the peers they are compared to."""
