"""What keeps a car from harm: limits, fence, ages, watchdog, and a button to hold."""
