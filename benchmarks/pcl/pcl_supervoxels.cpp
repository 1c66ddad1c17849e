// SPDX-License-Identifier: Apache-2.0
// VCCS and LCCP of the Point Cloud Library on one cloud: labels of each point, and seconds.
//
// Usage: pcl_supervoxels IN OUT VOXEL SEED COLOR SPATIAL NORMAL CAMERA REPEATS
//
//   IN       uint32 width, uint32 height, float32 xyz (height * width, 3) in metres, uint8 rgb (height * width, 3)
//   OUT      uint32 supervoxel (height * width), uint32 LCCP segment (height * width); 0: none
//   VOXEL, SEED              metres
//   COLOR, SPATIAL, NORMAL   weights
//   CAMERA   1: single camera transform, 0: none
//   REPEATS  timed runs, 0 or more; one that is not timed comes first
//
// The last line on stdout is JSON; each value is a list over the runs:
//
//   vccs_s, vccs_cpu_s    constructor, setters, setInputCloud and extract; seconds on the clock and of the processor
//   lccp_s                getSupervoxelAdjacency, setInputSupervoxels and segment: 10 degrees, smoothness check on
//   voxels, supervoxels   how many
//
// Neither class uses threads in PCL 1.13.

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <iostream>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/segmentation/lccp_segmentation.h>
#include <pcl/segmentation/supervoxel_clustering.h>

namespace {

using Point = pcl::PointXYZRGBA;
using Cloud = pcl::PointCloud<Point>;
using Clusters = std::map<std::uint32_t, pcl::Supervoxel<Point>::Ptr>;

constexpr float kConcavityDegrees = 10.0f;
constexpr float kSmoothness = 0.1f;  // PCL's default

struct Setting {
  float voxel, seed, color, spatial, normal;
  bool camera;
};

struct Result {
  std::vector<std::uint32_t> supervoxels, segments;
  std::vector<double> vccs_s, vccs_cpu_s, lccp_s, voxels, count;
};

class Clock {
 public:
  double seconds() const {
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
  }
  double cpu_seconds() const { return double(std::clock() - cpu_start_) / CLOCKS_PER_SEC; }

 private:
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
  std::clock_t cpu_start_ = std::clock();
};

Cloud::Ptr read_cloud(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  std::uint32_t size[2] = {0, 0};
  file.read(reinterpret_cast<char*>(size), sizeof size);
  const std::size_t n = std::size_t(size[0]) * size[1];
  std::vector<float> xyz(3 * n);
  std::vector<std::uint8_t> rgb(3 * n);
  file.read(reinterpret_cast<char*>(xyz.data()), xyz.size() * sizeof(float));
  file.read(reinterpret_cast<char*>(rgb.data()), rgb.size());
  if (!file) throw std::runtime_error("cannot read a whole cloud from " + path);
  Cloud::Ptr cloud(new Cloud(size[0], size[1]));
  cloud->is_dense = false;
  for (std::size_t i = 0; i < n; ++i) {
    Point& point = (*cloud)[i];
    point.x = xyz[3 * i], point.y = xyz[3 * i + 1], point.z = xyz[3 * i + 2];
    point.r = rgb[3 * i], point.g = rgb[3 * i + 1], point.b = rgb[3 * i + 2], point.a = 255;
  }
  return cloud;
}

std::vector<std::uint32_t> labels_of(const pcl::PointCloud<pcl::PointXYZL>& cloud) {
  std::vector<std::uint32_t> labels;
  labels.reserve(cloud.size());
  for (const auto& point : cloud) labels.push_back(point.label);
  return labels;
}

void run(const Cloud::Ptr& cloud, const Setting& setting, Result& result) {
  Clusters clusters;
  const Clock vccs_clock;
  pcl::SupervoxelClustering<Point> vccs(setting.voxel, setting.seed);
  vccs.setUseSingleCameraTransform(setting.camera);
  vccs.setColorImportance(setting.color);
  vccs.setSpatialImportance(setting.spatial);
  vccs.setNormalImportance(setting.normal);
  vccs.setInputCloud(cloud);
  vccs.extract(clusters);
  result.vccs_s.push_back(vccs_clock.seconds());
  result.vccs_cpu_s.push_back(vccs_clock.cpu_seconds());
  result.voxels.push_back(double(vccs.getVoxelCentroidCloud()->size()));
  result.count.push_back(double(clusters.size()));

  const Clock lccp_clock;
  std::multimap<std::uint32_t, std::uint32_t> adjacency;
  vccs.getSupervoxelAdjacency(adjacency);
  pcl::LCCPSegmentation<Point> lccp;
  lccp.setConcavityToleranceThreshold(kConcavityDegrees);
  lccp.setSmoothnessCheck(true, setting.voxel, setting.seed, kSmoothness);
  lccp.setInputSupervoxels(clusters, adjacency);
  lccp.segment();
  result.lccp_s.push_back(lccp_clock.seconds());

  const auto labelled = vccs.getLabeledCloud();
  result.supervoxels = labels_of(*labelled);
  lccp.relabelCloud(*labelled);
  result.segments = labels_of(*labelled);
}

void print_list(const char* name, const std::vector<double>& values, const char* end) {
  std::printf("\"%s\": [", name);
  for (std::size_t i = 0; i < values.size(); ++i) std::printf("%s%.6g", i ? ", " : "", values[i]);
  std::printf("]%s", end);
}

void write(const std::string& path, const Result& result) {
  std::ofstream file(path, std::ios::binary);
  for (const auto* labels : {&result.supervoxels, &result.segments})
    file.write(reinterpret_cast<const char*>(labels->data()), labels->size() * sizeof(std::uint32_t));
  if (!file) throw std::runtime_error("cannot write " + path);
  std::printf("{");
  print_list("vccs_s", result.vccs_s, ", ");
  print_list("vccs_cpu_s", result.vccs_cpu_s, ", ");
  print_list("lccp_s", result.lccp_s, ", ");
  print_list("voxels", result.voxels, ", ");
  print_list("supervoxels", result.count, "}\n");
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 10) {
    std::cerr << "usage: pcl_supervoxels IN OUT VOXEL SEED COLOR SPATIAL NORMAL CAMERA REPEATS\n";
    return 2;
  }
  try {
    const Cloud::Ptr cloud = read_cloud(argv[1]);
    const Setting setting{std::stof(argv[3]), std::stof(argv[4]), std::stof(argv[5]),
                          std::stof(argv[6]), std::stof(argv[7]), std::stoi(argv[8]) != 0};
    Result result;
    run(cloud, setting, result);
    for (auto* list : {&result.vccs_s, &result.vccs_cpu_s, &result.lccp_s, &result.voxels, &result.count})
      list->clear();
    for (int i = 0; i < std::stoi(argv[9]); ++i) run(cloud, setting, result);
    write(argv[2], result);
  } catch (const std::exception& error) {
    std::cerr << "pcl_supervoxels: " << error.what() << "\n";
    return 1;
  }
  return 0;
}
