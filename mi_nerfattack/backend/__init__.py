"""Dr.Jit and its LLVM: variants, versions, determinism, recordings, arrays of torch."""
