"""Tables: what their columns are, how records become rows, and the forms that they are printed in."""
