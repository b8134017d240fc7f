"""The NumPy reference: one file per concept, with functions named and ordered as in the OpenCL and Warp kernels.

A kernel function takes the set of flags and then the arguments of its row in the signature table, whose types the row
states. Arrays may be larger
than a launch needs; its counts give the used size. All arithmetic stays in the dtype of the arrays.
"""
