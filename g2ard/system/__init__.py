"""What g2ard uses of the machine: devices, memory, signals."""
