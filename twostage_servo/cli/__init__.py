"""The command line. One module a group of verbs; each imports what it needs when it runs, so that --help is instant."""
