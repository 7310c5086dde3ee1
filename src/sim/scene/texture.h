// SPDX-License-Identifier: Apache-2.0
/// @file What surfaces look like. Evaluated in batches so that inner loops vectorise.
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <memory>
#include <opencv2/core/mat.hpp>

#include "omnister/calibration/target.h"

namespace omnister::sim {

/// Red, green, blue; 0 to 255.
using Color = std::array<float, 3>;

/// Most samples of one batch.
inline constexpr int kBatch = 1024;

/// Samples on one surface. Arrays of `n` <= kBatch.
struct TextureSamples {
  int n = 0;
  const float* u = nullptr;  ///< surface coordinates [m]
  const float* v = nullptr;
  const float* width =
      nullptr;  ///< width of the area that the sample stands for, on the surface [m]
};

class Texture {
 public:
  virtual ~Texture() = default;
  /// Writes the colour of each sample, filtered to its width.
  virtual void evaluate(const TextureSamples& samples, float* red, float* green,
                        float* blue) const = 0;
};
using TexturePtr = std::shared_ptr<const Texture>;

/// Noise of several octaves: each is random values on a square lattice, turned against the other
/// octaves and joined smoothly. Octaves finer than a sample's width fade out.
struct NoiseParameters {
  double scale = 0.4;  ///< lattice spacing of the coarsest octave [m]
  int octaves = 7;
  double persistence = 0.8;  ///< amplitude of an octave over that of the next coarser one
  double contrast = 1.0;     ///< 0 to 1
  std::uint64_t seed = 1;
};

/// Blends two colours by noise.
TexturePtr makeNoise(const NoiseParameters& noise, const std::array<Color, 2>& colors);
TexturePtr makeSolid(const Color& color);
TexturePtr makeChecker(double size, const std::array<Color, 2>& colors);
/// @param variation share by which bricks differ in brightness, 0 to 1
TexturePtr makeBricks(double width, double height, double mortar, double variation,
                      std::uint64_t seed, const std::array<Color, 2>& colors);
/// One dot in most cells of a grid, at a random place inside the cell.
/// @param share of cells that have a dot
TexturePtr makeDots(double size, double radius, double share, std::uint64_t seed,
                    const std::array<Color, 2>& colors);
/// @param image CV_8UC3 (BGR)  @param width of the image on the surface [m]
TexturePtr makeImage(const cv::Mat& image, double width);
/// Multiplies a texture by 1 + noise.
TexturePtr makeGrain(TexturePtr base, const NoiseParameters& noise);

/// A calibration board in the target's own coordinates, and how far its pattern reaches.
struct BoardTexture {
  TexturePtr texture;
  Eigen::Vector2d low;  ///< corner of the pattern without margin [m]
  Eigen::Vector2d high;
  double margin = 0.0;  ///< white that detectors want around it [m]
};
/// @param dark @param light grey levels
/// @throws Error for a target that cannot be drawn
BoardTexture makeBoard(const Target& target, double dark, double light);

}  // namespace omnister::sim
