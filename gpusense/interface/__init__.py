"""What host and kernels agree on: signatures of kernels, flags, and specialised sources."""
