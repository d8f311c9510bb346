"""Picture files of other programs, and the colours that they state: as display values or as Rec.709."""
