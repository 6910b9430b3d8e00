"""The compiler: reads specifications for control, in a process that has nothing else."""
