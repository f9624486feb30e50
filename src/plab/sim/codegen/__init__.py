"""LLVM bitcode for the simulator: constitutive laws and their adjoints, and sums over grid nodes."""
