"""What one does with a machine: design a drive, simulate it, identify from its log, verify, report."""
