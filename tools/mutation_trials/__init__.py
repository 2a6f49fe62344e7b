"""Do the tests notice when the program is wrong? A change at random, the tests that call its function, and an answer.

``changes`` finds what can be changed in a module, ``test_map`` which tests call which function, ``runner`` makes one
change in a private copy of the checkout, ``server`` runs those tests, ``command`` draws and counts.
"""
