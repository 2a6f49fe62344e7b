"""What is written in letters: files of text in any usual encoding."""
