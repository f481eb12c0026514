"""Tutorial notebooks, and the program that runs them."""
