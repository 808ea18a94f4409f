"""What is checked before an attack is paid for."""
