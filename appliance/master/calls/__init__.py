"""The Master API: the steps of a request, the table of calls, and the effect of each call."""
