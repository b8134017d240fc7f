"""On GPUs work-items take tiles of neighbouring particles and rays; the reference takes everything at once.

With spread = s a tile of particles has 2^s groups, each with every 2^s-th tile of rays: few particles fill a device.
"""
