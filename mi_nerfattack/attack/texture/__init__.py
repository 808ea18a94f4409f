"""What an attack steps in: colours of an object, and which of them are allowed."""
