"""Functions for the simulator as LLVM bitcode: the laws and their adjoints, and sums over grid nodes."""
