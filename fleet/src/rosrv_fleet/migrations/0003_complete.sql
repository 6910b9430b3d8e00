-- The row is there while each stored segment is in the index, or waits for it.
CREATE TABLE complete (one boolean PRIMARY KEY DEFAULT true CHECK (one));
INSERT INTO complete SELECT true WHERE EXISTS (SELECT FROM segment);
