"""The walls around each process: what it may ask of the kernel (seccomp), its files and ports (Landlock)."""
