"""The simulated drive (plant, encoder, firmware, CAN node), the simulated bus and the virtual clock."""
