"""Bodies whose operations LLVM turns into vectors of 16 readings: arithmetic without calls and branches."""
