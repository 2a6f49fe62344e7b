"""Do the tests notice when the program is wrong? A change at random, the tests that execute its line, and an answer.

``changes`` finds what can be changed in a module, ``test_map`` which tests execute which line, ``runner`` makes one
change in a private copy of the checkout and runs those tests, ``command`` draws and counts.
"""
