"""Small worlds that several tests share, and the one place where they are made."""
