"""The NumPy reference: one file per concept, with functions named and ordered as in the OpenCL and Warp kernels.

A kernel takes the set of flags and then the arguments of its row in the signature table, which states their types;
functions whose code flags choose take the same arguments. Arrays may be larger
than a launch needs; its counts give the used size. All arithmetic stays in the dtype of the arrays.
"""
