"""The machine: cores, memory, processes, interrupts."""
