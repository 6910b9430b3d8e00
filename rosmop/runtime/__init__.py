"""The functions that specifications call: C++ arithmetic, strings, vectors, times and output."""
