"""The four tasks of the method, each from the composed stage to one layer of its own."""
