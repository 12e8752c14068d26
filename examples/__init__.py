"""Task families, experiments and a rival to copy from; none of it is in the installed package."""
