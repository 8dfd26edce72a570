"""What a diagnosis starts from: a look at the data, the floor, the base fit."""
