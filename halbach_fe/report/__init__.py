"""HTML pages, figures, tables and JSON summaries of results.

Each question has its page in ``…_page.py``, named like the module that computes the result. All
share `page` (the page itself), `answer` (what it says first) and `words` (quantities with units).
"""
