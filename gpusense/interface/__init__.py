"""The interface of host and kernels: signatures, flags, launches, constants and specialised sources."""
