//! Colours of bodies: the palette of Ravens.

/// What lies beyond the table.
pub const BACKGROUND: [u8; 3] = [24, 24, 26];
/// The plate of *placing*.
pub const PLATE: [u8; 3] = [36, 36, 38];
/// Red.
pub const RED: [u8; 3] = [255, 87, 89];
/// Blue.
pub const BLUE: [u8; 3] = [78, 121, 167];
/// Yellow.
pub const YELLOW: [u8; 3] = [237, 201, 72];
/// Green.
pub const GREEN: [u8; 3] = [89, 161, 79];
/// Orange.
pub const ORANGE: [u8; 3] = [242, 142, 43];
/// Purple.
pub const PURPLE: [u8; 3] = [176, 122, 161];
/// Cyan.
pub const CYAN: [u8; 3] = [118, 183, 178];
/// Pink.
pub const PINK: [u8; 3] = [255, 157, 167];
/// White.
pub const WHITE: [u8; 3] = [240, 240, 236];
/// Grey: beads.
pub const GREY: [u8; 3] = [186, 176, 172];
/// Pegs.
pub const PEG: [u8; 3] = [156, 117, 95];
