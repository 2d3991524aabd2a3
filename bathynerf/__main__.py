"""``python -m bathynerf``: the command line, where the console command is not on the path."""

from survey.commands.app import main

if __name__ == "__main__":
    main()
