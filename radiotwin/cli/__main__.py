"""`python -m radiotwin.cli`: the command line where its script is not on the path."""

from radiotwin.cli import main

main()
