"""Files, clocks and input checks for every package. This package imports no other package of the appliance."""
