"""`python -m radiotwin`: the command line where its script is not on the path."""

from radiotwin.cli import main

main()
