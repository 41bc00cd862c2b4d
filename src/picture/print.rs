//! A finished picture, and how it becomes a file.

use super::BACKGROUND;

/// Pixels, row by row from the top, red, green and blue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Three bytes a pixel.
    pub rgb: Vec<u8>,
}

impl Picture {
    /// Nothing, so large.
    pub fn empty(width: usize, height: usize) -> Picture {
        Picture { width, height, rgb: BACKGROUND.repeat(width * height) }
    }

    /// Puts another one there, as far as it fits.
    pub fn put(&mut self, other: &Picture, x: usize, y: usize) {
        let columns = other.width.min(self.width.saturating_sub(x));
        for row in 0..other.height.min(self.height.saturating_sub(y)) {
            let to = 3 * ((y + row) * self.width + x);
            let from = 3 * row * other.width;
            self.rgb[to..to + 3 * columns].copy_from_slice(&other.rgb[from..from + 3 * columns]);
        }
    }

    /// As a PNG.
    pub fn png(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_compression(png::Compression::Balanced);
        // Memory takes whatever is written: only a picture of no pixels can fail, and it is no picture.
        let written = encoder.write_header().and_then(|mut png| png.write_image_data(&self.rgb));
        if written.is_err() {
            bytes.clear();
        }
        bytes
    }

    /// As a JPEG of at most so many bytes, as good as that allows; the worst where none is small enough.
    pub fn jpeg(&self, most_bytes: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        for quality in [85, 75, 65, 55, 45, 35, 25, 15] {
            bytes.clear();
            let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, quality);
            encoder.set_optimized_huffman_tables(true);
            let (width, height) = (self.width as u16, self.height as u16);
            // As above.
            if encoder.encode(&self.rgb, width, height, jpeg_encoder::ColorType::Rgb).is_err() {
                bytes.clear();
            }
            if bytes.len() <= most_bytes {
                break;
            }
        }
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_takes_others_as_far_as_they_fit() {
        let mut picture = Picture::empty(4, 3);
        let black = Picture { width: 3, height: 2, rgb: vec![0; 18] };
        picture.put(&black, 2, 2);
        let dark: Vec<usize> = (0..12).filter(|i| picture.rgb[3 * i] == 0).collect();
        assert_eq!(dark, [10, 11]);
        picture.put(&black, 9, 9);
    }

    #[test]
    fn files_are_what_they_say() {
        let mut picture = Picture::empty(64, 48);
        picture.rgb.iter_mut().enumerate().for_each(|(i, x)| *x = (i * i % 251) as u8);
        let png = picture.png();
        let mut reader = png::Decoder::new(std::io::Cursor::new(&png)).read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut rgb).unwrap();
        assert_eq!(rgb, picture.rgb);
        let (large, small) = (picture.jpeg(usize::MAX), picture.jpeg(2500));
        assert!(large.starts_with(b"\xff\xd8\xff") && small.len() < large.len());
        assert!(small.len() <= 2500 || small == picture.jpeg(0));
    }
}
