"""Device kernels of gpusense: ``opencl/`` and ``warp/`` hold the same file names in the same order.

In a wheel this folder is the package ``gpusense.kernels``; in a checkout ``gpusense.interface.kernel_files`` loads it
under that name. It is never put on the module search path itself, where ``warp`` would hide the Warp library.
"""
