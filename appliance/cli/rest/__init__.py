"""The running appliance asked over REST."""
