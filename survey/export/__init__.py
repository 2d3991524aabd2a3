"""What is made of a finished run for other programs: `registry` lists the products, one file per family writes them."""
