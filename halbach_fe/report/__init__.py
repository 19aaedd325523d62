"""HTML pages, figures, tables and JSON summaries of results."""
