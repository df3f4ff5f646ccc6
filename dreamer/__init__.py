"""DreamerV3, trained wholly on the device."""
