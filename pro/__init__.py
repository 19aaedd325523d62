"""GetDP problem files: plain ``.pro`` files, and templates of the case data that are generated."""
