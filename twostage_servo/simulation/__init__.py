"""The simulated drive (plant, encoder, firmware, CAN node) and the virtual clock."""
