//! Pictures of meshes: shaded, faceted, the same whatever the threads, in memory that does not grow with the mesh where it
//! need not.
//!
//! A [`Camera`] looks at a scan from where its shape shows best and can zoom in; a [`Plate`] is what it exposes: a buffer
//! of the nearest surface behind each of four or nine samples a pixel. Drawing is an atomic minimum of depth and colour in one
//! number, so the order in which triangles come, and who draws them, changes nothing. [`Plate::develop`] makes the
//! [`Picture`].
//!
//! Promises: every visible triangle that covers a sample is seen, from either side; what is not finite is passed over.
//! **Memory.** Eight bytes a sample ([`Plate::bytes`]). A soup streams past. Of an indexed scan the positions are held, 12
//! bytes a vertex, where they fit; a scan of which not even these fit has far more vertices than a picture has samples, and
//! is drawn as dots, shaded by the depth around them.

mod camera;
mod draw;
mod plate;
mod print;
mod shade;

pub use camera::Camera;
pub use draw::{draw_mesh, draw_scan, held_bytes};
pub use plate::{Paint, Plate};
pub use print::Picture;

/// Samples along a pixel's side, for a picture that is looked at closely.
pub const FINE: usize = 3;
/// And for a small one among many.
pub const COARSE: usize = 2;

/// Behind everything: nearly white.
const BACKGROUND: [u8; 3] = [250, 250, 248];
