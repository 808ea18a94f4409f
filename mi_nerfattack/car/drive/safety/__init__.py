"""What keeps a car from harm: limits, fence, ages, speeds, and a button to hold."""
