"""Access to the machine: devices, memory, signals, optional packages."""
