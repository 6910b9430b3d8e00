"""Define formats that one of appliance and collector writes and the other reads."""
