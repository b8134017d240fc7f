"""On GPUs work-items take tiles of neighbouring particles and rays; the reference takes everything at once.

spread = s gives a tile of particles 2^s groups, each with every 2^s-th tile of rays: few particles fill a device.
"""
