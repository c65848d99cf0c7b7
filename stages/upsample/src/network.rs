use tch::{TchError, Tensor};

/// A network that enlarges images.
pub(crate) trait Network: Send {
    /// Times that it enlarges; `None`: any.
    fn scale(&self) -> Option<i64>;

    /// An image (1 × 3 × rows × columns, 0..1) at that many rows and columns; a network of one
    /// scale enlarges by that.
    fn enlarge(&self, image: &Tensor, size: [i64; 2]) -> Result<Tensor, TchError>;
}
