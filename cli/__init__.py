"""x."""
def main(): return 0
