"""Read and write files: bounded sizes, checked forms, atomic writes, content hashes."""
