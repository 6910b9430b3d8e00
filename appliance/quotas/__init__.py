"""Who may hold how much of what is finite: one way of counting (`pool`), one table of what is counted (`table`)."""
