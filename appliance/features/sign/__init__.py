"""Sign: signatures of the site beside policies and specifications."""
