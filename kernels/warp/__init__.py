"""Warp kernels, one concept a file; imported through ``gpusense._kernel_files.warp_module``."""
