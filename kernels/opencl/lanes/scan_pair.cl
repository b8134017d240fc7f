// A pair of scans, from their readings: place_pair of scan_pair.cl, with lines of LANES points at once.
// requires: lanes/line_fit lanes/sorting pair_steps

// in lanes: place_pair
