// SPDX-License-Identifier: Apache-2.0
// A client of `pcgraph serve`: writes the cloud of a file with its labels, as a PCD file, to the standard output.
// Build: g++ -std=c++17 client.cpp -lcurl -o client     Usage: ./client FILE [ADDRESS] > labelled.pcd
#include <curl/curl.h>
#include <cstdio>
#include <string>

int main(int argc, char** argv) {
    const std::string path = argv[1], address = argc > 2 ? argv[2] : "http://127.0.0.1:8000";
    CURL* curl = curl_easy_init();
    curl_easy_setopt(curl, CURLOPT_FAILONERROR, 1L);
    curl_mime* form = curl_mime_init(curl);
    curl_mimepart* part = curl_mime_addpart(form);
    curl_mime_name(part, "cloud");
    curl_mime_filedata(part, path.c_str());
    curl_easy_setopt(curl, CURLOPT_MIMEPOST, form);
    curl_easy_setopt(curl, CURLOPT_URL, (address + "/segmentations?wait=60").c_str());
    curl_easy_setopt(curl, CURLOPT_WRITEDATA, stderr);
    curl_header* location = nullptr;
    if (curl_easy_perform(curl) || curl_easy_header(curl, "Location", 0, CURLH_HEADER, -1, &location)) return 1;
    const std::string labels = address + location->value + "/labels?format=pcd";
    curl_easy_setopt(curl, CURLOPT_HTTPGET, 1L);
    curl_easy_setopt(curl, CURLOPT_URL, labels.c_str());
    curl_easy_setopt(curl, CURLOPT_WRITEDATA, stdout);
    const CURLcode failed = curl_easy_perform(curl);
    curl_mime_free(form);
    curl_easy_cleanup(curl);
    return failed ? 1 : 0;
}
