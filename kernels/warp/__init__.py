"""Warp kernels, one concept a file; imported through ``gpusense.interface.kernel_files.warp_module``."""
