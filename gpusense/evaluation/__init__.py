"""What shows that gpusense computes what it should: here, the proof of a device."""
