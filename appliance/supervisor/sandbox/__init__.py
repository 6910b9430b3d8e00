"""The sandbox of each process: limits on system calls (seccomp), and on files and ports (Landlock)."""
