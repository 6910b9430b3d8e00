"""The Master API: the table of calls, and the steps and effects of each."""
