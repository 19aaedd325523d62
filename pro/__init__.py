"""GetDP problem files: plain `.pro` files, and the template of the generated case data."""
