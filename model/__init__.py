"""What a machine is: its file, its rigid bodies, its contact with the soil, and what its equations predict."""
