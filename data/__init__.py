"""What the papers print, as tables; see README.md."""
