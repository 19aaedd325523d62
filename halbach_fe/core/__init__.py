"""What every other room uses: errors, files, arrays."""
